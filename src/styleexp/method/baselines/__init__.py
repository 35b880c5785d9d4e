"""The methods that the paper's is compared with (Sec. 4.2.3).

Two more need no code here and use the paper's loop: ``method=vertex`` is a field, and
``method=text2mesh`` an encoder and a loss.
"""
