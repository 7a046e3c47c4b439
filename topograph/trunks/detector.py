from __future__ import annotations
class Detector:
    def __init__(self,T,c): ...
    def __call__(self,scan,twist): raise NotImplementedError
