"""The whole: run a search, conclude, choose the noise model, warn; `identify()`, `Run`."""
