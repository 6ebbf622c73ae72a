"""The main job: logs to product in parts that survive a stop, in threads, in processes or on a cluster."""
