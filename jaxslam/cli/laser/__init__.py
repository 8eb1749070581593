"""`jaxslam run` on a laser log: options, mapping from known poses, localization in a map."""
