"""Files of other programs that tests write byte by byte."""

import hashlib
import json
import struct
import zlib

import h5py
import numpy as np
import OpenEXR


def write_matlab_7(path, fill):
    """Write a MATLAB 7.3 file, which is HDF5 behind a header of 512 bytes, and return its path."""
    with h5py.File(path, "w", userblock_size=512) as file:
        fill(file)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return path


def png(columns, rows):
    """Return a picture that claims to be of a size, and holds a million bytes."""
    head = struct.pack(">IIBBBBB", columns, rows, 16, 2, 0, 0, 0)
    chunks = (b"IHDR", head), (b"IDAT", zlib.compress(bytes(10**6))), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


def lytro_metadata(columns, rows, *, bits=12, upper_left="b", zoom=600, focus=800):
    """Return the metadata of a frame, with the names that the first Lytro (12 bits) and the Illum (10 bits) have."""
    black, white = (168, 4095) if bits == 12 else (64, 1023)
    details = {
        "pixelFormat": {
            "rightShift": 0,
            "black": dict.fromkeys(("r", "gr", "gb", "b"), black),
            "white": dict.fromkeys(("r", "gr", "gb", "b"), white),
        },
        "pixelPacking": {"endianness": "big" if bits == 12 else "little", "bitsPerPixel": bits},
        "mosaic": {"tile": "r,gr:gb,b", "upperLeftPixel": upper_left},
    }
    size = {"width": columns, "height": rows, "orientation": 1, "representation": "rawPacked"}
    return {
        "image": {**size, **({"rawDetails": details} if bits == 12 else details)},
        "devices": {
            "sensor": {"bitsPerPixel": bits, "pixelPitch": 1.4e-06},
            "lens": {
                "zoomStep": zoom,
                "focusStep": focus,
                "focalLength": 0.00684,
                "fNumber": 1.92,
                "exitPupilOffset": {"z": 0.1163},
            },
            "mla": {
                "tiling": "hexUniformRowMajor",
                "lensPitch": 1.4e-05,
                "rotation": -0.0021,
                "scaleFactor": {"x": 1, "y": 1.0005},
                "sensorOffset": {"x": 3.1e-06, "y": -2.6e-06, "z": 2.5e-05},
            },
        },
        "camera": {"make": "Lytro, Inc.", "model": "F01" if bits == 12 else "ILLUM"},
    }


def lytro_pixels(numbers, bits):
    """Pack digital numbers: pairs of 12 bits in big-endian order, or fours of 10 bits with the low bits last."""
    if bits == 12:
        return bytes.fromhex("".join(f"{number:03x}" for number in np.asarray(numbers, int).flat))
    packed = bytearray()
    for four in numbers.reshape(-1, 4).tolist():
        packed += bytes(number // 4 for number in four)
        packed.append(sum(number % 4 * 4**k for k, number in enumerate(four)))
    return bytes(packed)


def write_lytro(path, numbers, metadata):
    """Write a container as Lytro's cameras do; of 10 bits with the table of contents of the newer one."""
    details = metadata["image"].get("rawDetails", metadata["image"])
    bits = details["pixelPacking"]["bitsPerPixel"]
    data = {"metadataRef": json.dumps(metadata).encode(), "imageRef": lytro_pixels(numbers, bits)}
    data["privateMetadataRef"] = b'{"camera": {"serialNumber": "A000000000"}}'
    names = {part: f"sha1-{hashlib.sha1(each).hexdigest()}" for part, each in data.items()}
    frames = [{"frame": names}]
    contents = {"picture": {"frameArray": frames}} if bits == 12 else {"frames": frames}
    sections = [(b"M", json.dumps(contents).encode()), *((b"C", each) for each in data.values())]
    text = b"\x89LFP\r\n\x1a\n" + struct.pack(">II", 1, 0)
    for kind, each in sections:
        text += b"\x89LF" + kind + b"\r\n\x1a\n" + struct.pack(">II", 0, len(each))
        text += f"sha1-{hashlib.sha1(each).hexdigest()}".encode().ljust(80, b"\0") + each
        text += bytes(-len(text) % 16)
    path.write_bytes(text)
    return path


def write_lytro_white(path, numbers, metadata):
    """Write a white picture as it lies in a camera: pixels, with their metadata in a text file."""
    bits = metadata["image"].get("rawDetails", metadata["image"])["pixelPacking"]["bitsPerPixel"]
    path.with_suffix(".RAW").write_bytes(lytro_pixels(np.asarray(numbers), bits))
    frames = [{"frame": {"metadata": metadata}}]
    path.with_suffix(".TXT").write_text(json.dumps({"master": {"picture": {"frameArray": frames}}}))
    return path.with_suffix(".RAW")


LARGE = r"3221225472 bytes: it may have at most \d+"
"""What is said of a file that `large` wrote."""


def large(path):
    """Make a file of 3 GiB without any content, which takes no room on the disk."""
    with path.open("wb") as file:
        file.truncate(3 * 2**30)
    return path


def write_exr_parts(path, parts, attributes):
    """Write the parts of an OpenEXR file, channels by name, of which the first has our attributes."""
    headers = [{"mitsuba_plenoptic": json.dumps(attributes)}] + [{} for _ in range(len(parts) - 1)]
    size = np.array([0, 0]), np.max([plane.shape[::-1] for one in parts.values() for plane in one.values()], axis=0) - 1
    window = {"displayWindow": tuple(each.astype(np.int32) for each in size), "compression": OpenEXR.ZIP_COMPRESSION}
    made = [
        OpenEXR.Part(
            header | window | {"type": OpenEXR.scanlineimage},
            {name: OpenEXR.Channel(np.float32(plane)) for name, plane in channels.items()},
            part,
        )
        for header, (part, channels) in zip(headers, parts.items(), strict=True)
    ]
    OpenEXR.File(made).write(str(path))
