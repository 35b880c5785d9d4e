"""The paper's method, what it consists of, and the methods it is compared with."""
