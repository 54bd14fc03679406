"""Stage 1: traffic with SUMO."""
