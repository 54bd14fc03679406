"""Stage 2: vehicle dynamics by pybullet, parked vehicles and bystanders."""
