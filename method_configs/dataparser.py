"""The dataparser `splatart-capture`."""

from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from splatart_ns.plugin.dataparser import SplatartDataParserConfig

dataparser = DataParserSpecification(
    config=SplatartDataParserConfig(), description="Posed images of an articulated object at two or more states"
)
