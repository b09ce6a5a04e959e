"""Plans joint-torque trajectories for dynamic whole-arm manipulation in the plane."""
