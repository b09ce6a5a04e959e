"""Ipopt as every NLP uses it."""
