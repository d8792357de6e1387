"""The world around a run: files, devices, processes, signals and the command line."""
