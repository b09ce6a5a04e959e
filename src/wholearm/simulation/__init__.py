"""Forward simulation with contacts and joints that stick, slip and are gained."""
