"""The command `jaxslam consistency`: options, campaign, folder, films."""
