"""A traffic report in the files of other programs, each by a module of its own."""
