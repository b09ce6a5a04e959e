"""Values of parameters: sweeps over grids and samples, sensitivities, the best hand."""
