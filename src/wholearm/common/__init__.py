"""What every other package may use: errors, files, locks and caches, interrupts."""
