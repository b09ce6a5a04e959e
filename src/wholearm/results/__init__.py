"""What planning and simulation return: torques, trajectories, reports."""
