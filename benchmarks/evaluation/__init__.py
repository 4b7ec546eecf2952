"""The paper's evaluation side by side: every method, honest protocol, resumable runs, one machine or many."""
