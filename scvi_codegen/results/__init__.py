"""What is made of trajectories: recorded runs."""
