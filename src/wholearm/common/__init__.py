"""Utilities of all other packages: errors, files, locks and caches, interrupts."""
