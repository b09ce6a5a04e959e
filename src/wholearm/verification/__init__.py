"""Replay of plans and torques, and the verdict on them."""
