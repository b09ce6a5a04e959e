"""The stress study: generated scenes, damaged files, and checks of its own."""
