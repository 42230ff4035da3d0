"""The science of Skelebones: plain functions on plain values. Nothing here knows Prefect or Hydra."""
