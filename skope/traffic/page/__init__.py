"""A traffic report as one page to read and to print."""
