"""Many training runs on one or many machines (`gelflow sweep`)."""
