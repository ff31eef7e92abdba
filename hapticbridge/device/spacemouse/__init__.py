"""3Dconnexion SpaceMouse: input without force."""
