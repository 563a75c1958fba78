"""A bus over several hosts: certificates, passwords and who may say what."""
