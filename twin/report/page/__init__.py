"""`report.html`: map, scene, tables and the rehearsal on one page that needs no network."""
