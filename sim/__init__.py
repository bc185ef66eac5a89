"""The differentiable tactile simulator: scenes, C++ core, torch layer, tasks."""
