from .papers import PAPERS as PAPERS
