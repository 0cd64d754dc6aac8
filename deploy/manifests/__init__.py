"""The files that run and watch Topspin elsewhere, written from tables: `python -m deploy.manifests`."""
