"""People on foot, on bicycles and on motorcycles."""
