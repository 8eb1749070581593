"""What lies in the folder of a campaign: a file for each block of runs, and the manifest."""
