"""XML files of others: read as data, never as a program."""

from collections.abc import Callable, Sequence
from typing import Any

from lxml import etree

from shiftsim.errors import ConversionError


def xml_elements(
    data: bytes, root: str, fault: Callable[[str, str], ConversionError], names: Sequence[str] = ()
) -> list[Any]:
    """The children of the root that have one of some names, or the root itself. No comments.

    Names are those in any namespace. It is an error, made by `fault` of what is wrong and a remedy,
    if `data` are no XML, have another root, or a document type: entities and external references
    are refused.
    """
    parser = etree.XMLParser(
        remove_comments=True,
        remove_pis=True,
        resolve_entities=False,
        load_dtd=False,
        no_network=True,
        huge_tree=False,
    )
    try:
        found = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        raise fault(f"not well-formed XML: {error.msg}", "") from error
    if found.getroottree().docinfo.doctype:
        raise fault("has a DOCTYPE", "remove it and its entities")
    if etree.QName(found).localname != root:
        raise fault(f"its first element is not {root}", "")
    return list(found.iterchildren(*[f"{{*}}{name}" for name in names])) if names else [found]
