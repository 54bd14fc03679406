"""Traffic of several cameras in one database, day after day."""
