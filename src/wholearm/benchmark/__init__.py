"""Run time against error, beside plain baselines."""
