"""Soak tests: insertions with the mock robot under random faults, rules on their records, and the file of results."""
