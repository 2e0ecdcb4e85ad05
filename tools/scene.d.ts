// What the 3-D scene uses of three.js, as the server's page (NiceGUI) bundles it.

declare module "nicegui-scene" {
  export namespace THREE {
    const FrontSide: 0;
    const BackSide: 1;
    const DoubleSide: 2;
    const LinearFilter: 1006;
    const SRGBColorSpace: "srgb";

    class Vector3 {
      constructor(x?: number, y?: number, z?: number);
      x: number;
      y: number;
      z: number;
      set(x: number, y: number, z: number): this;
      clone(): Vector3;
      copy(other: Vector3): this;
      add(other: Vector3): this;
      sub(other: Vector3): this;
      addScaledVector(other: Vector3, factor: number): this;
      multiply(other: Vector3): this;
      multiplyScalar(factor: number): this;
      normalize(): this;
      length(): number;
      distanceTo(other: Vector3): number;
      project(camera: Camera): this;
      setFromSpherical(spherical: Spherical): this;
      setFromMatrixColumn(matrix: Matrix4, index: number): this;
      toArray(): [number, number, number];
    }

    class Spherical {
      theta: number;
      phi: number;
      setFromVector3(vector: Vector3): this;
    }

    class Quaternion {
      setFromUnitVectors(from: Vector3, to: Vector3): this;
    }

    class Matrix4 {
      makeScale(x: number, y: number, z: number): this;
      makeBasis(x: Vector3, y: Vector3, z: Vector3): this;
      setPosition(x: number, y: number, z: number): this;
    }

    class Sphere {
      center: Vector3;
      radius: number;
    }

    class Box3 {
      expandByObject(object: Object3D): this;
      isEmpty(): boolean;
      getBoundingSphere(sphere: Sphere): Sphere;
    }

    class Color {
      constructor(colour: string);
    }

    /** `geometry`, `material`, `element` and `dispose`: of objects that have them. */
    class Object3D {
      visible: boolean;
      renderOrder: number;
      position: Vector3;
      up: Vector3;
      matrix: Matrix4;
      quaternion: Quaternion;
      children: Object3D[];
      userData: { reach?: "hip" | "frame" | "room"; size?: [number, number] };
      isCSS2DObject?: true;
      geometry?: BufferGeometry;
      material?: Material;
      element?: HTMLElement;
      dispose?(): void;
      add(...objects: Object3D[]): this;
      remove(...objects: Object3D[]): this;
      traverse(visit: (object: Object3D) => void): void;
      traverseVisible(visit: (object: Object3D) => void): void;
      getWorldPosition(target: Vector3): Vector3;
    }

    class Group extends Object3D {}
    class Scene extends Object3D {
      background: Color;
    }
    class DirectionalLight extends Object3D {
      constructor(colour: string, intensity: number);
    }
    class AmbientLight extends Object3D {
      constructor(colour: string, intensity: number);
    }

    class Camera extends Object3D {}
    class PerspectiveCamera extends Camera {
      constructor(field: number, aspect: number, near: number, far: number);
      aspect: number;
      updateProjectionMatrix(): void;
    }

    class Texture {
      colorSpace: string;
      magFilter: number;
      minFilter: number;
      needsUpdate: boolean;
      dispose(): void;
    }
    class CanvasTexture extends Texture {
      constructor(canvas: HTMLCanvasElement);
    }
    class DataTexture extends Texture {
      constructor(data: Uint8Array, width: number, height: number);
    }

    interface Look {
      color?: string;
      opacity?: number;
      transparent?: boolean;
      side?: number;
      depthWrite?: boolean;
      map?: Texture;
    }
    class Material {
      map?: Texture;
      dispose(): void;
    }
    class MeshLambertMaterial extends Material {
      constructor(look: Look);
    }
    class MeshBasicMaterial extends Material {
      constructor(look: Look);
    }
    class PointsMaterial extends Material {
      constructor(look: Look & { size: number; sizeAttenuation: boolean; alphaTest: number });
    }
    class LineBasicMaterial extends Material {
      constructor(look: Look);
    }
    class LineDashedMaterial extends Material {
      constructor(look: Look & { dashSize: number; gapSize: number });
    }

    class Float32BufferAttribute {
      constructor(values: number[], size: number);
    }
    class BufferGeometry {
      setFromPoints(points: Vector3[]): this;
      setAttribute(name: string, values: Float32BufferAttribute): this;
      setIndex(index: number[]): this;
      computeVertexNormals(): void;
      applyMatrix4(matrix: Matrix4): this;
      dispose(): void;
    }
    class SphereGeometry extends BufferGeometry {
      constructor(radius: number, width: number, height: number);
    }
    class CylinderGeometry extends BufferGeometry {
      constructor(top: number, bottom: number, height: number, facets: number);
    }

    class Mesh extends Object3D {
      constructor(geometry: BufferGeometry, material: Material);
    }
    class InstancedMesh extends Mesh {
      constructor(geometry: BufferGeometry, material: Material, count: number);
      setMatrixAt(index: number, matrix: Matrix4): void;
    }
    class Points extends Object3D {
      constructor(geometry: BufferGeometry, material: Material);
    }
    class LineSegments extends Object3D {
      constructor(geometry: BufferGeometry, material: Material);
      computeLineDistances(): this;
    }

    class WebGLRenderer {
      constructor(options: { antialias: boolean });
      domElement: HTMLCanvasElement;
      setPixelRatio(ratio: number): void;
      setSize(width: number, height: number): void;
      render(scene: Scene, camera: Camera): void;
      dispose(): void;
      forceContextLoss(): void;
    }
  }

  export class CSS2DObject extends THREE.Object3D {
    constructor(element: HTMLElement);
    element: HTMLElement;
  }

  export class CSS2DRenderer {
    domElement: HTMLElement;
    setSize(width: number, height: number): void;
    render(scene: THREE.Scene, camera: THREE.Camera): void;
  }

  export class OrbitControls {
    constructor(camera: THREE.Camera, element: HTMLElement);
    target: THREE.Vector3;
    addEventListener(name: "change" | "start", listener: () => void): void;
    update(): void;
    dispose(): void;
  }
}
