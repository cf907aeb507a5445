"""The rules of the benchmark as small state machines over contacts. No simulator in here."""
