"""Plans in physics engines, without prescribed contacts: MuJoCo, Drake, and MJCF files."""
