"""XML files of others: read as data, never as a program."""

import io
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from lxml import etree

from shiftsim.errors import ConversionError


def xml_elements(
    data: bytes, root: str, fault: Callable[[str, str], ConversionError], names: Sequence[str] = ()
) -> Iterator[Any]:
    """The children of the root that have one of some names, or the root itself. No comments.

    Each is whole; a child is freed when the next is asked for.

    Args:
        data: The file.
        root: Name of the root, in any namespace.
        fault: Makes an error of what is wrong and a remedy, which may be empty.
        names: Names of the children, in any namespace; none: the root itself is given.

    Raises:
        ConversionError: It is not XML, has another root, or a document type: entities and external
            references are refused.
    """
    found = None
    try:
        for event, element in etree.iterparse(
            io.BytesIO(data),
            events=("start", "end"),
            tag=[f"{{*}}{name}" for name in (root, *names)],
            remove_comments=True,
            remove_pis=True,
            resolve_entities=False,
            load_dtd=False,
            no_network=True,
            huge_tree=False,
        ):
            if found is None:
                if element.getroottree().docinfo.doctype:
                    raise fault("has a DOCTYPE", "remove it and its entities")
                if element.getparent() is not None or etree.QName(element).localname != root:
                    break
                found = element
            if event == "end" and (element.getparent() if names else element) is found:
                yield element
                if names:
                    element.clear()
    except etree.XMLSyntaxError as error:
        raise fault(f"not well-formed XML: {error.msg}", "") from error
    if found is None:
        raise fault(f"its first element is not {root}", "")
