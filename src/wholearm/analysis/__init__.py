"""Slow motions, comparison, robustness and tuning of plans and torques."""
