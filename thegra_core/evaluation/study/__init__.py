"""The paper's experiment (Sec. IV-B): which filters and which features give most matches between thermal frames a fixed time apart."""
