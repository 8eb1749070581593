"""The command `jaxslam run`: options, filters, pieces, films."""
