"""The MuJoCo robot and the vectorised rally environment."""
