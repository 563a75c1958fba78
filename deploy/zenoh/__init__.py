"""A bus over several hosts: certificates, passwords, and which service may publish and read which topic."""
