"""Camera images to tactile frames: detect dots, fit the grid, measure displacement."""
