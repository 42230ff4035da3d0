"""How the work is run: configs, the store of artefacts, the graph of stages and the one Prefect flow."""
