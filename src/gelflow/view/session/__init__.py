"""Pages that show recorded sessions."""
