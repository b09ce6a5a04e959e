"""Plans in physics engines that are told nothing of contacts: MuJoCo, Drake, and MJCF files."""
