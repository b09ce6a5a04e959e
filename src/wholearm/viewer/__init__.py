"""Presentation of motions: movies, pages with players, and reports in one file."""
