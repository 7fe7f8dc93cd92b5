"""The program that shows a view: its window, its page, its pictures."""
