"""The science of Skelebones: plain functions on plain values. Nothing here knows Prefect or Hydra."""

from tasks.compiled import keep_kernels_by_source

keep_kernels_by_source()
