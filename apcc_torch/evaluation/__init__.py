"""How well methods know a real arm: tasks on recordings of it, the methods, and their scores beside each other."""
