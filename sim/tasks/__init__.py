"""Tasks built on the simulator: batched insertion attempts and their Gymnasium environments."""
