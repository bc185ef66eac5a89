"""Reports of evaluations: results beside those of other actors, films of episodes, and where failures lie."""
