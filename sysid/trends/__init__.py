"""Trends: weighted regression of estimates over a label such as length or temperature."""
