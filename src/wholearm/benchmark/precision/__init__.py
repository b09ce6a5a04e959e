"""Run time against error, of planner and simulator and of public tools beside them."""
