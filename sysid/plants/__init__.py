"""Reference plants that generate data: pneumatic tube and actuator; optional."""
