"""Configuration: Hydra's yaml groups and the typed root schema that binds the packages' own dataclasses."""
