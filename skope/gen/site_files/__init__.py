"""A user's own road: the site file, its camera, and what is wrong with them in one line."""
