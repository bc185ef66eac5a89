"""Drawing of scenes: what is to be drawn, and pictures of it without a display or OpenGL."""
