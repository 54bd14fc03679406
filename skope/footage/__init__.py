"""From footage to detections: predict, follow between key frames, confirm, anonymise, read live streams."""
