"""From footage to detections: predict, follow between key frames, confirm, anonymise, live streams."""
