"""The published experiments again: trainings with several seeds, evaluations, rows and curves beside the paper's."""
