"""A user's own road: what generating needs of a site file, and what is wrong with it in one line."""
