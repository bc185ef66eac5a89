"""Forces and readings of the pads as functions of the fitted parameters."""
