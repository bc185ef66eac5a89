"""Forces on the gel, from the displacements of its markers."""
