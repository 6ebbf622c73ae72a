"""Write a diagnosis: attribution, evidence, verdict, tables, text and surfaces."""
