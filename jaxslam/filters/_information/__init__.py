"""Information filters: EIF-SLAM, and the sparse filter SEIF."""
