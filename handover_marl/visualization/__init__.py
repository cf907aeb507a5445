"""Images, videos, figures and 3D replay pages of handovers, rendered without a screen."""
