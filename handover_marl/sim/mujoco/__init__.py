"""The world in MuJoCo; the only room that calls it. Models are built apart from worlds, so that many can share one."""
