"""How good the answers were: predicted before learnt."""
