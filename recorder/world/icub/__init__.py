"""The iCub scene: a robot that watches three objects move on a table."""
