"""What a diagnosis says: evidence on held-out time, surfaces, sentences, and the tables of the contract."""
