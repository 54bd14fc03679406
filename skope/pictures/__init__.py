"""Pictures and videos that are drawn on and written."""
