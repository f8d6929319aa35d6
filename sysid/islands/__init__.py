"""Islands, their topologies and migration."""
