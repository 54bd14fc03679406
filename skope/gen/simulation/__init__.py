"""Stage 2: vehicle dynamics with pybullet, parked vehicles and bystanders."""
