"""Reference plants that generate data, finer than their models: pneumatic tube and actuator."""
