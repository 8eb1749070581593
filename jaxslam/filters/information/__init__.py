"""Information filters: EIF-SLAM, and the sparse filters SEIF and ESEIF."""
