"""What a scene models, what that costs, what is wrong with it, and what could go unnoticed."""
