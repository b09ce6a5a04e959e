"""Run time against error, and other studies."""
