"""Tasks built on the simulator, with their batches and Gymnasium environments."""
