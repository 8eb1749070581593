"""The command `jaxslam optimize`: options, optimization, figure and film."""
