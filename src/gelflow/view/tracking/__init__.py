"""The page of `gelflow track --show`: markers and forces while images arrive."""
