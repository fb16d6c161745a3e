"""Trees of rigid bodies: kinematics, and the readers of URDF and MJCF."""
