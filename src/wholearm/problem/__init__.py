"""Problems: a scene, a start and phases, and the files that hold them."""
