"""Renders a Radiance scene with what others use.

    peers.py PEER SCENE.rad EDGE FOLDER RUNGS

PEER is rpict (Radiance, ambient file and overture), path (Mitsuba's path tracer) or denoised (that path tracer followed by
Open Image Denoise, guided by albedo and normals). RUNGS: only so many settings, the cheapest first.

The first line is {"versions": ...}, or {"missing": ...} where the peer is not installed; then one JSON object for each picture:
setting, cpu (seconds of all cores and processes), wall, file (EDGE x EDGE x RGB, 32-bit floats, top row first). Loading and
compiling are left out of Mitsuba's seconds, as are oconv's of Radiance's.
"""
import json, os, resource, subprocess, sys, time
from importlib.metadata import version
from pathlib import Path

peer, scene, edge, folder, rungs = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]), int(sys.argv[5])


def tell(**what):
    print(json.dumps(what), flush=True)


try:
    import numpy as np
    if peer == "rpict":
        import pyradiance
    else:
        import mitsuba as mi
        import pyoidn
except ImportError as missing:
    tell(missing=str(missing))
    sys.exit()


def statements(path):
    """Of a .rad file without commands: (modifier, kind, name, numbers)."""
    words = " ".join(line.split("#")[0] for line in open(path)).split()
    at = 0
    while at < len(words):
        head, lists = words[at:at + 3], []
        at += 3
        for _ in range(3):
            count = int(words[at])
            lists.append(words[at + 1:at + 1 + count])
            at += 1 + count
        yield (*head, [float(x) for x in lists[2]])


class Clock:
    """CPU seconds of this process and those it waited for, and wall seconds."""
    def __init__(self):
        self.start = self.now()

    def now(self):
        both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return sum(usage.ru_utime + usage.ru_stime for usage in both), time.monotonic()

    def seconds(self):
        return dict(zip(("cpu", "wall"), np.subtract(self.now(), self.start).tolist()))


def keep(setting, seconds, image):
    file = folder / "picture.f32"
    np.ascontiguousarray(image, dtype=np.float32).tofile(file)
    tell(setting=setting, file=str(file), **seconds)
    sys.stdin.readline()  # it has been read


# --- Radiance

def rectangles(lamps):
    """Two triangles a b c, a c d in a row are one rectangle: lamps are better sampled whole."""
    whole = []
    for a, b, c in lamps:
        if whole and len(whole[-1]) == 3 and whole[-1][0] == a and whole[-1][2] == b:
            whole[-1].append(c)
        else:
            whole.append([a, b, c])
    return whole


def rpict():
    home = Path(pyradiance.__file__).parent
    env = {**os.environ, "PATH": f"{home / 'bin'}:{os.environ['PATH']}", "RAYPATH": f".:{home / 'lib'}"}
    run = lambda *command: subprocess.run([str(c) for c in command], env=env, check=True, capture_output=True).stdout
    tell(versions={"Radiance": run("rpict", "-version").decode().strip(), "pyradiance": version("pyradiance")})
    lights, lamps = set(), {}
    with open(folder / "scene.rad", "w") as out:
        put = lambda modifier, kind, name, numbers: print(modifier, kind, name, 0, 0, len(numbers), *numbers, file=out)
        for modifier, kind, name, numbers in statements(scene):
            if kind == "light":
                lights.add(name)
            if kind == "polygon" and modifier in lights and len(numbers) == 9:
                lamps.setdefault(modifier, []).append(np.reshape(numbers, (3, 3)).tolist())
            else:
                put(modifier, kind, name, numbers)
        for name, triangles in lamps.items():
            for i, corners in enumerate(rectangles(triangles)):
                put(name, "polygon", f"{name}.{i}", np.ravel(corners).tolist())
    octree = folder / "scene.oct"
    octree.write_bytes(run("oconv", folder / "scene.rad"))
    # Accuracy and rays, and how many times finer each edge is before it is averaged: rpict takes one ray a pixel.
    ladder = [(0.3, 256, 1), (0.2, 512, 2), (0.15, 1024, 2), (0.15, 2048, 2), (0.1, 2048, 4), (0.1, 4096, 4)]
    for aa, ad, finer in ladder[:rungs]:
        ambient = folder / "scene.amb"
        ambient.unlink(missing_ok=True)
        options = ["-ab", 6, "-aa", aa, "-ad", ad, "-as", ad // 4, "-ar", 256, "-lw", 1e-4, "-af", ambient,
                   "-ps", 1, "-pj", 0.9, "-dj", 0.9, "-ds", 0.1, "-dc", 1, "-dt", 0]
        picture = lambda size: run("rpict", "-vf", scene.with_suffix(".vf"), "-x", size, "-y", size, *options, octree)
        clock = Clock()
        picture(max(edge // 8, 16))  # the overture
        (folder / "picture.hdr").write_bytes(picture(finer * edge))
        seconds = clock.seconds()
        floats = np.frombuffer(run("pvalue", "-h", "-H", "-o", "-df", folder / "picture.hdr"), np.float32)
        image = floats.reshape(edge, finer, edge, finer, 3).mean((1, 3))
        keep(f"-aa {aa} -ad {ad}, {finer}x", seconds, image)


# --- Mitsuba

def view(path):
    """Eye, direction, up and full angle."""
    words = open(path).read().split()
    three = lambda key: [float(x) for x in words[words.index(key) + 1:words.index(key) + 4]]
    return three("-vp"), three("-vd"), three("-vu"), float(words[words.index("-vh") + 1])


def world():
    """The scene as Mitsuba's dictionary: diffuse surfaces, metals (GGX of the same alpha), lamps, sun and sky."""
    eye, direction, up, angle = view(scene.with_suffix(".vf"))
    look = mi.ScalarTransform4f().look_at(origin=eye, target=np.add(eye, direction).tolist(), up=up)
    film = {"type": "hdrfilm", "width": edge, "height": edge, "pixel_format": "rgb", "component_format": "float32",
            "rfilter": {"type": "box"}}
    parts = {"type": "scene", "sensor": {"type": "perspective", "fov": angle, "to_world": look, "film": film}}
    rgb = lambda value: {"type": "rgb", "value": list(value)}
    diffuse = lambda color: {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(color)}}
    surfaces, emitted, triangles, sources = {}, {}, {}, []
    for modifier, kind, name, numbers in statements(scene):
        if kind == "plastic" and numbers[3] == 0:
            surfaces[name] = diffuse(numbers[:3])
        elif kind == "metal" and numbers[3] == 1:
            metal = {"type": "principled", "base_color": rgb(numbers[:3]), "metallic": 1.0, "roughness": numbers[4] ** 0.5}
            surfaces[name] = {"type": "twosided", "bsdf": metal}
        elif kind in ("light", "glow"):
            surfaces[name], emitted[name] = diffuse([0, 0, 0]), numbers[:3]
        elif kind == "polygon" and len(numbers) == 9:
            triangles.setdefault(modifier, []).append(np.reshape(numbers, (3, 3)))
        elif kind == "source":
            sources.append((emitted[modifier], np.array(numbers[:3]), numbers[3]))
        else:
            sys.exit(f"{scene}: {kind} {name}: not converted")
    for name, shapes in triangles.items():
        corners = np.array(shapes, np.float32).reshape(-1, 3)
        mesh = mi.Mesh(name, len(corners), len(corners) // 3)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = corners.ravel()
        parameters["faces"] = np.arange(len(corners), dtype=np.uint32)
        parameters.update()
        mesh.write_ply(str(folder / f"{name}.ply"))
        parts[name] = {"type": "ply", "filename": str(folder / f"{name}.ply"), "face_normals": True,
                       "bsdf": surfaces[name]}
        if name in emitted:
            parts[name]["emitter"] = {"type": "area", "radiance": rgb(emitted[name])}
    for i, (radiance, direction, degrees) in enumerate(sources):
        if degrees == 180:  # below the ground nobody sees it
            parts[f"source{i}"] = {"type": "constant", "radiance": rgb(radiance)}
            continue
        way = direction / np.linalg.norm(direction) * 5000  # a disc so far away that all see it in one direction
        size = 5000 * np.tan(np.radians(degrees / 2))
        place = mi.ScalarTransform4f().look_at(origin=way.tolist(), target=[0, 0, 0], up=[0.1, 0.2, 0.97])
        parts[f"source{i}"] = {"type": "disk", "to_world": place @ mi.ScalarTransform4f().scale([size, size, 1]),
                               "emitter": {"type": "area", "radiance": rgb(radiance)}}
    return parts


def mitsuba():
    for path in sorted(Path("/usr/lib").glob("*/libLLVM*19*")):
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(path))
    probe = "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); mi.render(mi.load_dict(mi.cornell_box()), spp=1).numpy()"
    works = subprocess.run([sys.executable, "-c", probe], capture_output=True).returncode == 0
    variant = "llvm_ad_rgb" if works else "scalar_rgb"
    tell(versions={"Mitsuba": f"{mi.__version__} {variant}", "pyoidn": version("pyoidn")})
    mi.set_variant(variant)
    loaded = mi.load_dict(world())
    integrator = {"type": "path", "max_depth": -1}
    if peer == "denoised":
        integrator = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal", "image": integrator}
    integrator = mi.load_dict(integrator)
    most = max(1, 2 ** 25 // edge ** 2)  # samples a pixel in one pass: they must fit memory

    def render(spp, seed):
        total = 0.0
        for done in range(0, spp, most):
            count = min(most, spp - done)
            total = total + count * np.array(mi.render(loaded, integrator=integrator, spp=count, seed=seed + done))
        return (total / spp).astype(np.float32)

    for spp in ([16, 64, 256, 1024, 4096] if peer == "path" else [8, 32, 128, 512, 2048])[:rungs]:
        render(min(spp, most), 1000)  # compiles
        clock = Clock()
        image = render(spp, 0)
        if peer == "denoised":
            color, albedo, normal = (np.ascontiguousarray(image[..., 3 * k:3 * k + 3]) for k in range(3))
            image = pyoidn.denoise(color, albedo=albedo, normal=normal, hdr=True)
        keep(f"{spp} spp", clock.seconds(), image)


rpict() if peer == "rpict" else mitsuba()
