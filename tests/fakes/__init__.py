"""Small services with the real declarations' shape: fast, deterministic, without MuJoCo or torch."""
