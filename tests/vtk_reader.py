"""Reads VTKHDF files back as ParaView does, by VTK's own reader."""

from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
from vtkmodules.vtkIOHDF import vtkHDFReader


class VtkFile:
    """Times of a file, None if it has no steps, and what is in it at a step."""

    def __init__(self, path):
        self._reader = vtkHDFReader()
        self._complaints = []
        for event in ("ErrorEvent", "WarningEvent"):
            self._reader.AddObserver(event, lambda _, kind: self._complaints.append(kind))
        assert self._reader.CanReadFile(str(path))
        self._reader.SetFileName(str(path))
        self._reader.UpdateInformation()
        self.times = self._reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS())
        assert not self._complaints

    def step(self, index):
        """The data set of a step and its point data, numpy arrays by name."""
        if self.times is None:
            self._reader.Update()
        else:
            self._reader.UpdateTimeStep(self.times[index])
        data = self._reader.GetOutputDataObject(0)
        assert not self._complaints
        arrays = data.GetPointData()
        names = [arrays.GetArrayName(k) for k in range(arrays.GetNumberOfArrays())]
        return data, {name: vtk_to_numpy(arrays.GetArray(name)) for name in names}
