"""The depth camera on the robot's wrist: its optics, what it sees by name, and how real ones fall short."""
