"""Files of users and files for them: read, written whole or not at all, names checked, output folders claimed."""
