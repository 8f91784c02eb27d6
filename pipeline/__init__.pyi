from pipeline.use.model import Octopi as Octopi
