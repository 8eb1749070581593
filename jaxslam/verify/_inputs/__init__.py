"""What is verified: functions, claims, samples, a user's file."""
