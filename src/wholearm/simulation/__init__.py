"""Forward simulation, which shares nothing with planning but the model."""
