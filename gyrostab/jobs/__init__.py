"""The whole analysis in parts that survive a stop, in threads, in processes or on a cluster."""
