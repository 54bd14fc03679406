"""Stage 1: traffic by SUMO."""
