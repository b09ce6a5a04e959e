"""Motions to look at: movies, pages that play them, and reports in one file."""
