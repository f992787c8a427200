"""Reports: evidence is read first, then shown as figures and tables on one page that needs no network."""
