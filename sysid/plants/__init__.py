"""Reference plants that generate data (tube, actuator); optional."""
