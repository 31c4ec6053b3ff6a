"""The paper's theory as executable definitions (`igm.py`, `process.py`) and tests; `README.md` says what they found."""
