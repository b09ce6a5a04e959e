"""What does not move by plan: object, fingers, friction, gravity."""
