"""What every service consists of: settings, log, metrics, process, connection, membership, run folder."""
