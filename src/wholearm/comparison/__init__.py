"""Plans and torques for one problem, side by side."""
